"""Free flights and transmittance of media, and paths through surfaces and several media."""
