"""Small two-player zero-sum games in extensive form, and exact best responses in them."""
