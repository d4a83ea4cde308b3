"""What QGIS itself makes of an inventory: a program for the Python that has QGIS's modules, which are not ours.

It takes one task as JSON on a line of standard input and answers with JSON on a line of its own:

- ``look``: the project's layers as QGIS has read them, and what QGIS complains of;
- ``edit``: change, move, draw and delete in the edit buffer of layers, and save;
- ``draw``: a picture of the project's map.

The project stays open until standard input ends.
"""

from __future__ import annotations

import json
import os
import sys
from typing import Any

os.environ["QT_QPA_PLATFORM"] = "offscreen"

from qgis.core import (
    QgsApplication,
    QgsFeatureRequest,
    QgsGeometry,
    QgsMapRendererParallelJob,
    QgsMapSettings,
    QgsProject,
    QgsVectorLayer,
    QgsVectorLayerUtils,
)
from qgis.PyQt.QtCore import QSize


def look(project: Any) -> dict[str, Any]:
    """The layers by name."""
    return {
        "crs": project.crs().authid(),
        "title": project.title(),
        "layers": {layer.name(): told(layer) for layer in project.mapLayers().values()},
        "order": [node.name() for node in project.layerTreeRoot().findLayers()],
    }


def told(layer: Any) -> dict[str, Any]:
    """A layer."""
    found = {"valid": layer.isValid(), "crs": layer.crs().authid(), "provider": layer.providerType()}
    if not isinstance(layer, QgsVectorLayer):
        return found
    alone = QgsVectorLayer(layer.source(), "alone", layer.providerType())  # as one that is dragged in by itself
    return found | {
        "features": layer.featureCount(),
        "renderer": renderer(layer),
        "renderer_alone": renderer(alone),
        "fields": fields(layer),
        "fields_alone": fields(alone),
        "tabs": [tab.name() for tab in layer.editFormConfig().tabs()],
    }


def renderer(layer: Any) -> list[list[Any]]:
    """Categories of a layer: value, colour, opacity."""
    if layer.renderer() is None or layer.renderer().type() != "categorizedSymbol":
        return []
    return [[c.value(), c.symbol().color().name(), c.symbol().opacity()] for c in layer.renderer().categories()]


def fields(layer: Any) -> dict[str, dict[str, Any]]:
    """Fields of a layer: how they are edited and what they are held against."""
    found = {}
    for at, field in enumerate(layer.fields()):
        setup, constraints = layer.editorWidgetSetup(at), field.constraints()
        config = setup.config()
        found[field.name()] = {
            "type": field.typeName(),
            "title": field.alias(),
            "widget": setup.type(),
            "values": [next(iter(entry)) for entry in config.get("map", [])],
            "range": [config.get("Min"), config.get("Max")],
            "locked": layer.editFormConfig().readOnly(at),
            "rule": constraints.constraintExpression(),
            "default": layer.defaultValueDefinition(at).expression(),
        }
    return found


def edit(project: Any, steps: list[dict[str, Any]]) -> dict[str, Any]:
    """Do the steps in the edit buffers of their layers and save; which rules of the form each of them breaks."""
    broken = []
    layers = {}
    for step in steps:
        layer = project.mapLayersByName(step["layer"])[0]
        layers[step["layer"]] = layer
        if not layer.isEditable():
            assert layer.startEditing(), layer.name()
        broken.append(take(layer, step))
    for layer in layers.values():
        assert layer.commitChanges(), layer.commitErrors()
    return {"broken": broken}


def take(layer: Any, step: dict[str, Any]) -> list[str]:
    """Do a step; names of the fields whose rules it breaks."""
    values = {layer.fields().indexOf(name): value for name, value in step.get("values", {}).items()}
    shape = QgsGeometry.fromWkt(step["wkt"]) if "wkt" in step else None
    if step["do"] == "draw":
        feature = QgsVectorLayerUtils.createFeature(layer, shape, values)
        assert layer.addFeature(feature)
    else:
        request = QgsFeatureRequest().setFilterExpression(f"\"asset_id\" = '{step['asset']}'")
        (feature,) = layer.getFeatures(request)
        if step["do"] == "delete":
            assert layer.deleteFeature(feature.id())
            return []
        for at, value in values.items():
            assert layer.changeAttributeValue(feature.id(), at, value)
        if shape is not None:
            assert layer.changeGeometry(feature.id(), shape)
        feature = layer.getFeature(feature.id())
    return [
        field.name()
        for at, field in enumerate(layer.fields())
        if field.name() != "fid" and not QgsVectorLayerUtils.validateAttribute(layer, feature, at)[0]
    ]


def draw(project: Any, file: str, around: list[str]) -> dict[str, Any]:
    """Write a picture of the map around some layers."""
    settings = QgsMapSettings()
    settings.setDestinationCrs(project.crs())
    settings.setLayers([layer for layer in project.layerTreeRoot().layerOrder() if layer.isValid()])
    settings.setOutputSize(QSize(1000, 600))
    extent = project.mapLayersByName(around[0])[0].extent()
    for name in around[1:]:
        extent.combineExtentWith(project.mapLayersByName(name)[0].extent())
    settings.setExtent(extent.buffered(3.0))
    job = QgsMapRendererParallelJob(settings)
    job.start()
    job.waitForFinished()
    assert job.renderedImage().save(file)
    return {"errors": [f"{error.layerID}: {error.message}" for error in job.errors()]}


def main() -> None:
    """Do the task of standard input."""
    task = json.loads(sys.stdin.readline())
    app = QgsApplication([], True)
    app.initQgis()
    messages: list[str] = []
    app.messageLog().messageReceived.connect(lambda text, tag, level: messages.append(f"{tag} {level}: {text}"))
    project = QgsProject.instance()
    assert project.read(task["project"]), project.error()
    if task["do"] == "look":
        answer = look(project)
    elif task["do"] == "edit":
        answer = edit(project, task["steps"])
    else:
        answer = draw(project, task["file"], task["around"])
    sys.stdout.write(json.dumps(answer | {"messages": messages}) + "\n")
    sys.stdout.flush()
    sys.stdin.read()
    project.clear()  # closes its files
    os._exit(0)


if __name__ == "__main__":
    main()
