"""Names of the members of an RPC: of GDAL's tags on the left, of the class `RPC` on the right."""

SCALARS = {
    "LINE_OFF": "row_offset",
    "SAMP_OFF": "col_offset",
    "LAT_OFF": "lat_offset",
    "LONG_OFF": "lon_offset",
    "HEIGHT_OFF": "alt_offset",
    "LINE_SCALE": "row_scale",
    "SAMP_SCALE": "col_scale",
    "LAT_SCALE": "lat_scale",
    "LONG_SCALE": "lon_scale",
    "HEIGHT_SCALE": "alt_scale",
}
VECTORS = {
    "LINE_NUM_COEFF": "row_num",
    "LINE_DEN_COEFF": "row_den",
    "SAMP_NUM_COEFF": "col_num",
    "SAMP_DEN_COEFF": "col_den",
}

__all__ = ["SCALARS", "VECTORS"]
