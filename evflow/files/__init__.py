"""Files of any kind: written completely or not at all, and read without trusting their headers.

Nothing here depends on events.
"""
