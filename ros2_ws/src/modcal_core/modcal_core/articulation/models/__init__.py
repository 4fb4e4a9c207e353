"""Joint types, one a file: each is all of its type, and is registered as a package's own is (:mod:`.registry`)."""
