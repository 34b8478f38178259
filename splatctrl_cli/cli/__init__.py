"""The command line, a file per subcommand. It alone parses, prints, exits and catches."""
