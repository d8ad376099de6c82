"""The commands of ``python -m ditr_lite``."""
