r"""Equations of the catalogue in LaTeX: one for each built-in constitutive model and effect, by its
key in the registry.

The code of the laws is the definition; a test asks that every entry of the registries has an equation here. All are in
dimensional form. ``\lambda = R/R_\infty`` is the stretch ratio at the wall, ``b`` the hoop stretch within the gel.
"""

_NH = r"-\frac{G}{2}\left(5 - \frac{4}{\lambda} - \frac{1}{\lambda^4}\right)"
_NEWTON = r"-\frac{4\mu\dot R}{R}"
_QKV = (
    r"\alpha G\left(\frac{177}{20} + \frac{1}{4\lambda^8} + \frac{2}{5\lambda^5} - "
    r"\frac{3}{2\lambda^4}"
    r" + \frac{2}{\lambda^2} - \frac{6}{\lambda} - 4\lambda\right)"
)
_LINEAR = r"-\frac{4}{3}G_\mathrm{lin}\left(1 - \frac{1}{\lambda^3}\right)"
_FUNG = (
    r"2G\int_1^{\lambda}\left(\frac{1}{b^2} + \frac{1}{b^5}\right)%s\,\mathrm{d}b, \qquad x = "
    r"b^{-4} + 2b^2 - 3"
)
_MAXWELL = r"\frac{Z}{R^3} - \frac{4 s \mu\dot R}{R}, \qquad \tau\dot Z + Z = -4(1 - s)\,\mu R^2\dot R"
_SOLID = (
    r"\dot S = \frac{S_\mathrm{e} - S}{\tau} - \frac{4\mu}{\tau}\frac{\dot R}{R} - f\,\frac{\dot "
    r"R}{R}, \qquad "
    r"S_\mathrm{e} = %s, \qquad f = %s"
)
_THIN = (
    r"-\frac{4\dot R}{R}\int_0^1 \mu\left(\dot\gamma_\mathrm{w}x\right)\mathrm{d}x, \qquad "
    r"\mu(\dot\gamma) = \mu\left(1 + (t_s\dot\gamma)^2\right)^{-s/2}, \qquad "
    r"\dot\gamma_\mathrm{w} = 2\sqrt 3\,\frac{|\dot R|}{R}"
)

MODELS = {
    "newtonian": f"S = {_NEWTON}",
    "nhe": f"S = {_NH}",
    "nhkv": f"S = {_NEWTON} {_NH}",
    "qkv": f"S = {_NEWTON} {_NH} + {_QKV}",
    "gen_qkv": f"S = {_NEWTON} {_NH} + {_QKV}",
    "linkv": f"S = {_NEWTON} {_LINEAR}",
    "fung2": f"S = {_NEWTON} {_NH} - " + _FUNG % r"\left(a x + \frac{a^2x^2}{2}\right)",
    "fungexp": f"S = {_NEWTON} {_NH} - " + _FUNG % r"\left(e^{a x} - 1\right)",
    "maxwell": f"S = {_MAXWELL}",
    "zener": f"S = {_NH} + {_MAXWELL}",
    "sls": _SOLID % (_LINEAR, r"4G_\mathrm{lin}"),
    "sns": _SOLID
    % (
        _NH,
        r"\frac{4G}{\lambda^3 - 1}\left(\frac{3}{14}\lambda^3 + \lambda^2 - \frac{3}{2\lambda} + "
        r"\frac{2}{7\lambda^4}\right)",
    ),
    "ucm": (
        r"S = \frac{Z_1 + Z_2}{R^3} - \frac{4 s\mu\dot R}{R}, \qquad "
        r"\tau\dot Z_1 + \left(1 - 2\tau\frac{\dot R}{R}\right)Z_1 = \tau\dot Z_2 + \left(1 + "
        r"\tau\frac{\dot R}{R}\right)Z_2"
        r" = -2(1 - s)\,\mu R^2\dot R"
    ),
    "carreau": f"S = {_NH} {_THIN}",
}
"""Key of a constitutive model -> its stress integral."""

EFFECTS = {
    "strain_stiffening": f"\\Delta S = {_QKV}",
    "stress_relaxation": r"\tau\dot Z + Z = -4\mu R^2\dot R \quad\text{in "
    r"place of}\quad Z = -4\mu R^2\dot R",
    "shear_thinning": r"\mu \to \mu\left(1 + (t_s\dot\gamma)^2\right)^{-s/2}",
    "damage": r"S_\mathrm{e} \to (1 - D)\,S_\mathrm{e}, "
    r"\qquad \dot D = k\,(1 - D)\,\frac{|\dot R|}{R}",
    "healing_damage": r"S_\mathrm{e} \to (1 - D)\,S_\mathrm{e}, \qquad \dot D = k\,(1 - D)\,\frac{|\dot R|}{R} "
    r"- \frac{D}{t_h}",
    "viscous_damage": r"S_\mathrm{v} \to (1 - D)\,S_\mathrm{v}, "
    r"\qquad \dot D = k\,(1 - D)\,\frac{|\dot R|}{R}",
    "yield_stress": r"\Delta S = -2\tau_y\,\mathrm{sign}(\dot R)\,\ln\frac{r_y}{R}",
    "graded_modulus": r"G \to G\left(1 + g\,(R_\infty/r_0)^3\right)",
    "permanent_set": (
        r"S_\mathrm{e}(R/R_\infty) \to S_\mathrm{e}(R/R_0), \qquad R_0 = R_\infty + "
        r"s\,(R_\mathrm{max} - R_\infty)"
    ),
    "heat_exchange": r"k_\mathrm{gas} \to k_\mathrm{gas}\,e^{h}",
    "vapour_pressure": r"p_\mathrm{v} \to p_\mathrm{v} + v\,p_\infty",
    "condensation": r"p_\mathrm{v} \to p_\mathrm{v}\left(P/P(0)\right)^{c}",
    "gas_loss": (
        r"-\frac{\dot n}{n} = \eta\,\frac{|\dot R|}{R}\left(1 - \frac{R}{R_\infty}\right)^2 "
        r"\quad\text{while } R < R_\infty"
    ),
    "sound_speed": r"c \to c\,e^{x}",
    "compressibility": r"\mathrm{KM} \to (1 - x)\,\mathrm{KM} + x\,\mathrm{KM}_2,"
    r"\quad \mathrm{KM}_2 \text{ to order } \dot R^2/c^2",
    "surface_tension": r"\gamma \to \gamma\,e^{x} \quad\text{at the wall}",
    "far_field_pressure": r"p(\infty) \to p_\infty\,(1 + x)",
    "wall": r"w = \pm\frac{R_\mathrm{max}}{2d} \quad\text{at the distance } d",
    "energy_loss": r"\Delta S \propto -\zeta\,\dot R|\dot R|\,\frac{R_\infty^2}{R^2 + R_\infty^2}",
    "size_drag": r"\Delta S = -k R \dot R",
    "residual_velocity": r"\dot R(0) = x\,U_c",
    "sound_field": r"p(\infty, t) = p_\infty\left(1 + a\sin(\omega t + \varphi)\right)",
    "pulse": r"p(\infty, t) = p_\infty\left(1 + a\,e^{-(t - t_p)^2/w^2}\right)",
    "excess_gas": r"n(0) = n(R_\infty)\,e^{x}",
    "hot_contents": r"T(0) = T_\infty\,(1 + x)",
    "rinf_drift": r"\frac{\dot n}{n} = 3d",
    "density": r"\rho \to \rho\,e^{x}",
    "missed_maximum": r"R_\mathrm{max} \to R_\mathrm{max}\,(1 + x)",
    "trigger_offset": r"t \to t + x\,R_\mathrm{max}/U_c",
    "rinf_bias": r"R_\infty \to R_\infty\,(1 + x)",
    "clock": r"t \to t\,e^{x} \quad\text{at a fixed time scale}",
    "exposure_blur": r"R_\mathrm{seen}(t) = \frac{1}{w}\int_{t - w/2}^{t + w/2} R\,\mathrm{d}t'",
    "refraction": r"R_\mathrm{seen} = R\left(1 + x\,R/R_\mathrm{max}\right)",
    "edge_error": r"R_\mathrm{seen} = R + d",
}
"""Name of an effect -> what it changes."""
