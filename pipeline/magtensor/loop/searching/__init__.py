"""The search: which effects are tried, what each has to show, what is adopted, and what is said of the rest."""
