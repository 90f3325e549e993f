"""Free flights, transmittance and paths through media and between surfaces."""
