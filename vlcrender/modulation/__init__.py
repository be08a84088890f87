"""What LEDs transmit: the keys of `downlink` tables, waves, codes, packets, and how much their light flickers.

Depends on neither scenes, cameras nor files. docs/downlink.md shows it at work.
"""
