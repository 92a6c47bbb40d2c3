"""Motion databases: the bytes of an archive, what packs and unpacks them, and the codecs of their numbers."""
