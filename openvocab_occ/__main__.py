"""`python -m openvocab_occ` is `openvocab-occ`."""

from openvocab_occ.cli import script

if __name__ == "__main__":
    script()
