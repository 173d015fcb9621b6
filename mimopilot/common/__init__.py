"""General helpers without flight knowledge: files, TOML, tables, processes, charts, intervals."""
