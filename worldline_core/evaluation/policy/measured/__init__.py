"""Evidence measured by colour tracking: no language model, only things that an instruction names by colour."""
