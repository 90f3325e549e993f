"""The irradiance cache: statistics, lookups, angular moments, error estimates and files."""
