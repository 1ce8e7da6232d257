"""What the map `validity` says of a cell."""

UNSEEN, MEASURED, FILLED, UNWANTED, LEVELLED = 0, 1, 2, 3, 4
MEANING = (
    "1 = measured: two images see it; 2 = filled from neighbours: hidden from all but one; 0 = unseen; "
    "3 = outside the area that was asked for; 4 = water about which images do not agree: its level is assumed"
)
# code -> colour on maps, name
CLASSES = {
    UNSEEN: ("#737373", "unseen"),
    MEASURED: ("#1a9850", "measured"),
    FILLED: ("#fdae61", "filled from neighbours"),
    UNWANTED: ("#f7f7f7", "outside the area"),
    LEVELLED: ("#4393c3", "water, level assumed"),
}

__all__ = ["CLASSES", "FILLED", "LEVELLED", "MEANING", "MEASURED", "UNSEEN", "UNWANTED"]
