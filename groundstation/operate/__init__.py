"""The ground's end of the wire: Zenoh link, keys, settings, other programs started and ended."""
