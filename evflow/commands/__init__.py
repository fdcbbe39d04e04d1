"""The commands, a file each: a frozen dataclass whose fields are the options and whose `run` does
the work. What a command needs is imported in `run`, so that `evflow --help` is quick."""
