"""The exception of code generation."""

from mimopilot.common.errors import Error


class CodegenError(Error, RuntimeError):
    """Code generation or compilation failed."""
