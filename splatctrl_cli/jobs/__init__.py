"""Jobs behind the commands: a typed request in, a typed result out, no terminal."""
