"""How a job runs: what it says, where it computes, how an interrupted one continues."""
