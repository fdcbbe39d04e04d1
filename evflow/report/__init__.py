"""Pictures and words about an estimated camera (pictures need the extra `viz`)."""
