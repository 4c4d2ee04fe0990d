"""Stage 8, where the model fails: the gap between simulation and data, its place, its cause, and how far it shrinks."""
