"""Draws and tabulates the values it is handed; opens no database."""
