"""The interactive viewer: ``irrcache view``."""
