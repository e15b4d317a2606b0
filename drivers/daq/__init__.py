"""The bench's hardware on a data-acquisition card of National Instruments; extra `daq`."""
