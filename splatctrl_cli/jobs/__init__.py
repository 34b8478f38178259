"""What each command does, without a terminal: a typed request in, a typed result out."""
