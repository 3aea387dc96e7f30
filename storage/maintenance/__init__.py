"""Maintenance of whole stores: archives, verification and thinning."""
