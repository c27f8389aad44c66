"""From words and files to a configuration, its checks and its objects."""
