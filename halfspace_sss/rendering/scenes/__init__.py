"""Scenes from files and for Mitsuba alone, and long renders in passes."""
