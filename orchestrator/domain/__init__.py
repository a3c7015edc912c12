"""Pure values: jobs and how they end, gangs, hosts, errors."""
