"""MSDI's image network: `adaptive`'s images, bettered by what their neighbours and the spikes say."""
