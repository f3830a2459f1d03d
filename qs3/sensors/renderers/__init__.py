"""Renderers behind one protocol: Blender and Mitsuba."""
