"""Settings of the estimator: mode, gains, bandwidths."""

from dataclasses import dataclass
from typing import Any, ClassVar, Literal

from estimator.model import require, require_declared


@dataclass(frozen=True, slots=True, kw_only=True)
class EstimatorSettings:
    """Settings of both modes; each mode reads its own.

    Attributes:
        mode: "robust" (sums of blocks of one balance), or "paper" (eqs 14, 28, 32, 33 as printed, correctly
            discretised).
        method: source of the stiffness: "mbe" (the transmission's model), "bbe" (black box), or "auto": "mbe"
            in robust mode with a model, else "bbe".
        bandwidth_rad_s: of the filter that every channel shares in robust mode.
        k_tau_rad_s: K_tau_e of eq 14.
        k_sigma_1_rad2_s2: K_sigma,1 of eq 28.
        k_sigma_2_rad_s: K_sigma,2 of eq 28.
        k_r_s2_rad2: K_R of eq 32.
        k_max: K_max < 2 of eq 33.
        valid_within: relative standard deviation of the stiffness, at most 1, below which it is valid in
            robust mode.
        false_alarms_per_hour: of `changed` in robust mode and of the model alarm; a higher rate finds smaller
            changes.
        external_bandwidth_rad_s: of the external torque's filter in robust mode; in mode "paper" K_tau_e.
        external_bias_s: time constant of a bias (payload, wrong gravity) that is subtracted from the external
            torque; a lasting push fades with it. None: no bias.
        contact_torque_nm: least external torque that counts as a contact; None: 5 % of the largest torque
            carried.
        contact_false_alarms_per_hour: of the contact bit; a higher rate finds smaller contacts.
    """

    __pydantic_config__: ClassVar[dict[str, Any]] = {"extra": "forbid", "strict": True}

    mode: Literal["robust", "paper"] = "robust"
    method: Literal["auto", "mbe", "bbe"] = "auto"
    bandwidth_rad_s: float = 60.0
    k_tau_rad_s: float = 300.0
    k_sigma_1_rad2_s2: float = 300.0
    k_sigma_2_rad_s: float = 1.0
    k_r_s2_rad2: float = 1900.0
    k_max: float = 1.9
    valid_within: float = 0.2
    false_alarms_per_hour: float = 1.0
    external_bandwidth_rad_s: float = 200.0
    external_bias_s: float | None = None
    contact_torque_nm: float | None = None
    contact_false_alarms_per_hour: float = 1.0

    def __post_init__(self) -> None:
        require_declared(
            0.0,
            strict=True,
            bandwidth_rad_s=self.bandwidth_rad_s,
            k_tau_rad_s=self.k_tau_rad_s,
            k_sigma_1_rad2_s2=self.k_sigma_1_rad2_s2,
            k_sigma_2_rad_s=self.k_sigma_2_rad_s,
            k_r_s2_rad2=self.k_r_s2_rad2,
            k_max=self.k_max,
            valid_within=self.valid_within,
            false_alarms_per_hour=self.false_alarms_per_hour,
            external_bandwidth_rad_s=self.external_bandwidth_rad_s,
            contact_false_alarms_per_hour=self.contact_false_alarms_per_hour,
        )
        if self.external_bias_s is not None:
            require_declared(0.0, strict=True, external_bias_s=self.external_bias_s)
        if self.contact_torque_nm is not None:
            require_declared(0.0, contact_torque_nm=self.contact_torque_nm)
        require(
            self.valid_within <= 1.0, f"valid_within: expected a number in (0, 1], got {self.valid_within}"
        )
        require(self.k_max < 2.0, f"k_max: expected a number in (0, 2), got {self.k_max}")
