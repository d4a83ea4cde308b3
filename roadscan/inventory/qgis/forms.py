"""QGIS forms: widget, title, limits and permission to edit for each column of a kind, as elements of its XML."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final
from xml.etree.ElementTree import Element, SubElement

from roadscan.inventory.conflicts import CONFLICT_COLUMNS, DECISION
from roadscan.inventory.home import CHOICES
from roadscan.store.asset_schema import AssetColumn, asset_schema
from roadscan.store.inventory_schema import asset_columns, editable_columns

_NOT_NULL: Final = 1  # Bit of QGIS's constraint flags: not null.
_EXPRESSION: Final = 4  # Bit of QGIS's constraint flags: expression.
_HARD: Final = 1
"""Constraint strength: QGIS refuses values that violate it; 2 would warn."""


def form_elements(kind: str) -> list[Element]:
    """Elements `fieldConfiguration`, `aliases`, `constraints`, `constraintExpressions`, `defaults`, `editable` and the
    layout of the form of a kind's layer (QGIS 3).
    """
    columns = asset_columns(kind)
    widgets, aliases = Element("fieldConfiguration"), Element("aliases")
    constraints, expressions = Element("constraints"), Element("constraintExpressions")
    defaults, editable = Element("defaults"), Element("editable")
    may_edit = editable_columns(kind)
    for index, column in enumerate(columns, start=1):  # the feature's number is field 0
        field = SubElement(widgets, "field", name=column.name, configurationFlags="None")
        field.append(_widget(column, is_editable=column.name in may_edit))
        title = column.title if column.unit in ("text", "number", "date", "1") else f"{column.title} ({column.unit})"
        SubElement(aliases, "alias", index=str(index), field=column.name, name=title)
        rule = _rule(column)
        strength = str(_HARD) if rule else "0"
        flags = str(_EXPRESSION) if rule else "0"
        SubElement(
            constraints, "constraint", field=column.name, constraints=flags, exp_strength=strength,
            notnull_strength="0", unique_strength="0",
        )  # fmt: skip
        SubElement(expressions, "constraint", field=column.name, exp=rule, desc=_rule_words(column) if rule else "")
        default = "'confirmed'" if column.name == "status" else ""
        SubElement(defaults, "default", field=column.name, expression=default, applyOnUpdate="0")
        SubElement(editable, "field", name=column.name, editable="1" if column.name in may_edit else "0")
    return [widgets, aliases, constraints, expressions, defaults, editable, *_layout(kind)]


def decision_elements() -> list[Element]:
    """Elements `fieldConfiguration` and `editable` of conflicts: a value list for what is decided, all else locked."""
    widgets, editable = Element("fieldConfiguration"), Element("editable")
    for name in (*CONFLICT_COLUMNS, DECISION):
        field = SubElement(widgets, "field", name=name, configurationFlags="None")
        is_free = name == DECISION
        field.append(_value_map(CHOICES, nullable=True) if is_free else _configured("TextEdit", {"IsMultiline": True}))
        SubElement(editable, "field", name=name, editable=str(int(is_free)))
    return [widgets, editable]


def _rule(column: AssetColumn) -> str:
    """Returns QGIS's constraint expression for a value; empty where any value is valid."""
    name = f'"{column.name}"'
    if column.values:
        listed = ", ".join("'" + value.replace("'", "''") + "'" for value in column.values)
        return f"{name} IS NULL OR {name} IN ({listed})"
    limits = [f"{name} >= {column.min:g}" if column.min is not None else "",
              f"{name} <= {column.max:g}" if column.max is not None else ""]  # fmt: skip
    words = " AND ".join(limit for limit in limits if limit)
    return f"{name} IS NULL OR ({words})" if words else ""


def _rule_words(column: AssetColumn) -> str:
    if column.values:
        return f"One of {', '.join(column.values)}."
    low = "" if column.min is None else f"{column.min:g} or more"
    high = "" if column.max is None else f"{column.max:g} or less"
    return f"{' and '.join(words for words in (low, high) if words)}."


def _widget(column: AssetColumn, *, is_editable: bool) -> Element:
    if column.values and is_editable:
        return _value_map(column.values, nullable=column.nullable)
    if column.type == "bool":
        return _configured("CheckBox", {"CheckedState": "", "UncheckedState": "", "AllowNullState": True})
    if column.type == "date":
        options = {"display_format": "yyyy-MM-dd", "field_format": "yyyy-MM-dd", "calendar_popup": True,
                   "allow_null": True}  # fmt: skip
        return _configured("DateTime", options)
    if column.type.startswith("int") and column.min is not None and column.max is not None:
        limits = {"Min": int(column.min), "Max": int(column.max), "Step": 1, "AllowNull": True, "Style": "SpinBox"}
        return _configured("Range", limits)
    return _configured("TextEdit", {"IsMultiline": column.name in ("comments", "pictures"), "UseHtml": False})


def _value_map(values: Sequence[str], *, nullable: bool) -> Element:
    widget = Element("editWidget", type="ValueMap")
    config = SubElement(widget, "config")
    options = SubElement(config, "Option", type="Map")
    listed = SubElement(options, "Option", type="List", name="map")
    null = "{2839923C-8B7D-419E-B84B-CA2FE9B80EC7}"  # QGIS's own text for NULL
    for shown, value in [("", null)] * nullable + [(value, value) for value in values]:
        entry = SubElement(listed, "Option", type="Map")
        SubElement(entry, "Option", type="QString", name=shown, value=value)
    return widget


def _configured(kind: str, options: Mapping[str, Any]) -> Element:
    widget = Element("editWidget", type=kind)
    held = SubElement(SubElement(widget, "config"), "Option", type="Map")
    for name, value in options.items():
        is_flag = isinstance(value, bool)
        type_ = "bool" if is_flag else "int" if isinstance(value, int) else "QString"
        SubElement(held, "Option", name=name, type=type_, value=str(value).lower() if is_flag else str(value))
    return widget


def _layout(kind: str) -> list[Element]:
    """Returns two tabs: what people edit, and what was measured."""
    form = Element("attributeEditorForm")
    columns = asset_columns(kind)
    may_edit = editable_columns(kind)
    tabs = {
        asset_schema(kind).title: [c for c in columns if c.name in may_edit or c.name == "asset_id"],
        "Measured": [c for c in columns if c.name not in may_edit and c.name != "asset_id"],
    }
    for title, own in tabs.items():
        tab = SubElement(form, "attributeEditorContainer", name=title, columnCount="1", groupBox="0", showLabel="1",
                         visibilityExpressionEnabled="0", visibilityExpression="")  # fmt: skip
        for column in own:
            index = str(columns.index(column) + 1)
            SubElement(tab, "attributeEditorField", name=column.name, index=index, showLabel="1")
    layout = Element("editorlayout")
    layout.text = "tablayout"
    return [layout, form]
