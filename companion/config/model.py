"""The base of all settings models: frozen, no unknown keys, no silent conversions, numbers finite."""

from __future__ import annotations

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field


class SettingsModel(BaseModel):
    """What every table of a settings file has in common."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, use_attribute_docstrings=True)


Positive = Annotated[float, Field(gt=0.0)]
NotNegative = Annotated[float, Field(ge=0.0)]
Number3 = tuple[float, float, float]
Positive3 = tuple[Positive, Positive, Positive]
NotNegative3 = tuple[NotNegative, NotNegative, NotNegative]
