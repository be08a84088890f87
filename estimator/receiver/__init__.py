"""Reception: which LED each striped LED image is, decoded from the light of its lines."""
