"""The report of flights: one page with figures of a log, of two logs, or of gain sets around them."""
