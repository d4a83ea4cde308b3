"""QGIS forms, styles and project file of the inventory, all derived from the schemas of the kinds."""
