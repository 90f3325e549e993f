"""Free-flight sampling, transmittance estimation and path tracing in media and between surfaces."""
