"""Many recordings through many commands: a suite, its graph, the processes that run it, the ledger of runs."""
