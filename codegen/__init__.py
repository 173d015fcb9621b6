"""From gains to files, and from files to a running library: knows nothing of VRFT or of the plant."""
