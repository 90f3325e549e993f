"""File input and output: images, scenes and volumes in Mitsuba's format."""
