"""Files: images, scenes and volumes in Mitsuba's format."""
