"""Batches: suite, graph, processes, and ledger of runs."""
