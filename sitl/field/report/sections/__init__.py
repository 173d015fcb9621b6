"""The sections of a flight report, one module each: from the flights and gain sets to figures and tables."""
