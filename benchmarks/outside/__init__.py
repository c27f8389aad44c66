"""Problems of others, solved by torchgco and by peers: one judge, one table each."""
