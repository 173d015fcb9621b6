"""What is not about flight: files, tables, processes, charts."""
