"""How every command prints: text, tables, errors, and the options that commands share."""
