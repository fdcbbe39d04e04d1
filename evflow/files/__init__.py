"""Files, whatever they hold: written whole or not at all, and read without trusting what they say.

Nothing here knows of events.
"""
