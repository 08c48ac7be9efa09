"""The survey: its data model, the canonical file layout, mappings from users' files, and checks of the data."""
