"""The machine and the process: devices, memory, environment variables, versions, output streams."""
