"""The irradiance cache: its values, statistics and files."""
