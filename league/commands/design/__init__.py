"""Commands for those who bring a robot of their own."""
