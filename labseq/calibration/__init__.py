"""Everything about calibrations: their store, how each is measured, their pictures and commands."""
