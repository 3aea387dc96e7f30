"""Files, temporary folders and ports of this machine, as dashboards use them."""
