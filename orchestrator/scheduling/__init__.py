"""The scheduler: pure decisions over a snapshot. Order, fair share, gang admission, backfill, preemption, reasons for waiting."""
