"""What QGIS shows the inventory by: forms, styles and a project file, all of them from the schemas of the kinds."""
