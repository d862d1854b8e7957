"""The order of the examples in the gallery: from curves to trips."""

ORDER = (
    "plot_paper.py",
    "plot_own_data.py",
    "plot_feature_maps.py",
    "plot_identifiability.py",
    "plot_recording.py",
    "plot_commissioning.py",
    "plot_rig.py",
    "plot_maintenance.py",
    "plot_sweep.py",
)


def place(file: str) -> int:
    """Return the place of an example; those that are not listed come last."""
    return ORDER.index(file) if file in ORDER else len(ORDER)
