"""Episodes and the sets they form: the contract between recordings and everything else."""
