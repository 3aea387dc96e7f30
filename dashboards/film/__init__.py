"""Pictures and films of matches, drawn on the CPU without a graphics driver."""
