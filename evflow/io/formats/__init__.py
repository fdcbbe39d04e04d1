"""One module a format: its NAME and EXTENSIONS, `sniff`, `read`, and a writer where it has one."""
