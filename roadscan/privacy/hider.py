"""Hides people and vehicles in pictures of a survey, by what its settings name."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from roadscan.compute.array_types import UInt8
from roadscan.core.errors import ConfigError
from roadscan.core.extras import cv2
from roadscan.pictures.placed import Pictures
from roadscan.privacy.detector import Detector
from roadscan.privacy.hiding import KINDS, Region, hidden
from roadscan.privacy.returns import ClassedReturns
from roadscan.privacy.settings import PrivacyConfig
from roadscan.run.code_reach import code_digest
from roadscan.run.engine.fingerprint import key_of
from roadscan.run.session import Session, found_once
from roadscan.store.digest import file_digest


@dataclass(frozen=True, eq=False)
class Hider:
    """Hides people and vehicles in pictures."""

    config: PrivacyConfig
    returns: ClassedReturns | None
    model: Path | None

    @classmethod
    def of(cls, session: Session) -> Hider:
        """Return the hider of a survey.

        Raises
        ------
        ConfigError
            where nothing says what is to be hidden: neither classified points nor a detector.
        """
        config = PrivacyConfig.of(session.survey)
        returns = ClassedReturns.of(session) if config.from_classes else None
        model = None if config.detector is None else session.survey.resolve(config.detector.model)
        if returns is None and model is None:
            raise ConfigError(
                "pictures are to be blurred, and nothing says where: the survey has no classified points, and "
                "privacy.detector names no network",
                expected="the stage assets with classified = true, or [privacy.detector]",
                change='name one of them, or state privacy.pictures = "off" and answer for it',
            )
        if model is not None and not model.is_file():
            raise ConfigError("the detector is not there", expected="privacy.detector.model, an ONNX file", file=model)
        return cls(config, returns, model)

    @property
    def sources(self) -> list[str]:
        """Names of what says where to blur."""
        found = ["returns of vehicles and people"] if self.returns is not None else []
        return found + ([f"detector {self.model.name}"] if self.model is not None else [])

    @cached_property
    def detector(self) -> Detector | None:
        """The network; None where none is named."""
        if self.model is None or self.config.detector is None:
            return None
        return Detector(self.model, self.config.detector)

    @cached_property
    def key(self) -> str:
        """Hash of the settings, the network and the code."""
        model = "" if self.model is None else file_digest(self.model)
        code = code_digest(f"{__name__}:Hider")
        return key_of(code, self.config.model_dump(mode="json", exclude={"detector": {"model"}}), model)

    def key_of(self, pictures: Pictures, number: int) -> str:
        """Return a hash of all that says what is hidden in a picture, besides the picture itself."""
        east, north = pictures.place_m[number].tolist()
        near = [] if self.returns is None else self.returns.near(east, north, self.config.reach_m)
        return key_of(self.key, [record.digest for record in near], pictures.lens_key, number_key(pictures, number))

    def regions(self, pictures: Pictures, number: int, picture: UInt8) -> list[Region]:
        """Return what is hidden in a picture (height, width, 3; red first), margins included."""
        found: list[Region] = []
        if self.returns is not None:
            found += self.returns.regions(pictures, number, self.config.reach_m)
        if self.detector is not None:
            found += self.detector.find(picture)
        return [one.wider(self.config.margin) for one in found]

    def hide(self, pictures: Pictures, number: int, picture: UInt8) -> tuple[UInt8, dict[str, int]]:
        """Return a picture with all that hidden, and how much of what was."""
        regions = self.regions(pictures, number, picture)
        return hidden(picture, regions), counts_of(regions)

    def hide_found(self, picture: UInt8) -> UInt8:
        """Return a cut-out with what the network finds hidden."""
        found = [] if self.detector is None else self.detector.find(picture)
        return hidden(picture, [one.wider(self.config.margin) for one in found])


@found_once
def hider_of(session: Session) -> Hider:
    """Return the hider of a survey; raises as :meth:`Hider.of`."""
    return Hider.of(session)


def number_key(pictures: Pictures, number: int) -> str:
    """Return a hash of a picture's pose."""
    views = pictures.views
    return key_of(views.eye_world_m[number].tolist(), views.opencv_from_world[number].tolist())


def counts_of(regions: list[Region]) -> dict[str, int]:
    """Return how many regions there are of each kind."""
    return {what: sum(one.what == what for one in regions) for what in KINDS}


def decoded(content: bytes) -> UInt8:
    """Return a picture (height, width, 3; red first) in the orientation of its sensor; OSError where it is damaged."""
    known = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION
    picture = cv2.imdecode(np.frombuffer(content, np.uint8), known) if content else None
    if picture is None:
        raise OSError("the image cannot be decoded")
    return np.ascontiguousarray(picture[:, :, ::-1])


def encoded(picture: UInt8, quality: int = 90) -> bytes:
    """Return a picture (height, width, 3; red first) as a JPEG without any tags."""
    done, content = cv2.imencode(
        ".jpg", np.ascontiguousarray(picture[:, :, ::-1]), [int(cv2.IMWRITE_JPEG_QUALITY), quality]
    )
    if not done:
        raise OSError("the image cannot be encoded")
    return bytes(content.tobytes())
