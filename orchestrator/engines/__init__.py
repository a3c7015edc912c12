"""What starts processes on machines: one module an engine, all behind :class:`orchestrator.engines.base.Engine`."""
