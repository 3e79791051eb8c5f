"""Bare recordings and other programs' camera files become scene folders."""
