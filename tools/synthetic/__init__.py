"""Synthetic scenes: layouts, textures, and a ray caster with exact depth."""
