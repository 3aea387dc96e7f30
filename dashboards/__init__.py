"""Robot League's dashboards: they draw and tabulate the values that they are given, and open no database."""
