"""Robot League's storage: rows, blobs and recordings, kept so that no crash loses them."""
