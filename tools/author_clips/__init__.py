"""Makes the clips that ship in `assets/motions`; not part of the installed package."""
