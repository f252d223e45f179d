"""What decoders of this package raise: quant knows nothing of files, so who reads one says which."""


class DamagedDataError(ValueError):
    """Coded data contradicts itself: it is truncated, damaged or forged."""
