"""Numerical helpers, plugin properties and utilities that do not depend on rendering."""
