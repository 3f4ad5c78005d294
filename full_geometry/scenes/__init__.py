"""Scene files, registration of the plugins, and long renders in passes."""
