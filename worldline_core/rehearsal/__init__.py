"""A preset run at small size with every outside model present: a rehearsal on two cores before the run on many GPUs."""
