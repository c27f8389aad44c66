"""Plants by other authors' simulators, each behind an extra: they fly what a mission's tracker commands."""
