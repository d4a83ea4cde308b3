"""PSI containers read whole, for tests."""

from __future__ import annotations

from pathlib import Path

from roadscan.formats.scanners.psi_container import PsiContainer, PsiFile


def read_psi(path: Path) -> PsiContainer:
    """Read a PSI file.

    Raises
    ------
    FormatError
        if it is no sound PSI file, or a codec is not read.
    """
    file = PsiFile.open(path)
    return PsiContainer(file.header, file.image2d(), file.surface3d(), file.metadata())
