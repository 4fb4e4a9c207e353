"""The league: methods of the field on the same recordings and splits, scored on readings that none of them has seen."""
