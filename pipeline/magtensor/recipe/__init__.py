"""Recipes: safe YAML with positions, the schema, and the plan that is checked before any data are read."""
