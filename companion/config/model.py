"""The base of all settings models: frozen, no unknown keys, no silent conversions, numbers finite."""

from __future__ import annotations

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field


class SettingsModel(BaseModel):
    """What every table of a settings file has in common."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, use_attribute_docstrings=True)


Number = Annotated[float, Field(strict=True)]
Positive = Annotated[float, Field(gt=0.0, strict=True)]
NotNegative = Annotated[float, Field(ge=0.0, strict=True)]
Positive3 = tuple[Positive, Positive, Positive]
NotNegative3 = tuple[NotNegative, NotNegative, NotNegative]
