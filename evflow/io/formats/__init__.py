"""One module per format: its NAME and EXTENSIONS, `sniff`, `read`, and a writer if there is one."""
