"""The commands, one file each: a frozen dataclass whose fields are the options and whose `run` does
the work. Heavy imports happen in `run`, so that `evflow --help` is quick."""
