"""Jobs behind the commands, without a terminal: a typed request in, a typed result out."""
