"""Synthetic scenes: layout, textures and a ray caster."""
