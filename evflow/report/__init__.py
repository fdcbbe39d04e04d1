"""Reports on estimated cameras and event streams (pictures need the extra `viz`)."""
