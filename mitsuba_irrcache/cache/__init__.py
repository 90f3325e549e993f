"""The irradiance cache: values, statistics, angular moments, direct light, errors, files."""
