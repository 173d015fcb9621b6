"""``python -m mimopilot``: the command line."""

from mimopilot.cli.main import main

main()
