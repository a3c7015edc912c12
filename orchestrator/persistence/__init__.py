"""The database: tables, sessions, queries, migrations."""
