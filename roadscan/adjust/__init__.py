"""The adjustment: places where passes meet, ties between passes and to control points, and corrections of the poses."""
