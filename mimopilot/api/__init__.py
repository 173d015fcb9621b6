"""What `import mimopilot` offers: one function for each thing that the command line does.

Paths may be `str` or `Path`. Every function raises `mimopilot.Error` for what its caller can correct, and gives the
same bits as the command of its name.
"""
