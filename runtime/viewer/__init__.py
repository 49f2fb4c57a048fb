"""Scenes in the browser, and the report of an inference."""
