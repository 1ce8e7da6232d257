"""The commands there are, known without importing any of them."""

# name -> first line of help; a command's module is imported only when it is called, so that --help stays fast
COMMANDS = {
    "prep": "Images with RPC cameras -> scene with bundle-adjusted RPCs.",
    "normalise": "Digital numbers -> linear radiance or reflectance, masks.",
    "prior": "Multi-view matching -> rough surface, confidence, normals.",
    "fit": "Fit a volumetric scene by differentiable rendering.",
    "export": "Fitted scene -> DSM, albedo, shadows as georeferenced files.",
    "align": "Move a scene onto a reference DEM or control points.",
    "compare": "Compare a DSM with lidar and print the error table.",
    "change": "Two dates -> what has risen or sunk, volumes, significance.",
    "simulate": "Make a ray-traced scene with known truth.",
    "batch": "Many scenes in many configurations -> one table, error against seconds.",
    "report": "Scene or batch -> one self-contained HTML page.",
    "info": "Print a summary of a scene.",
    "doctor": "Say what is installed and what is missing.",
}

# what commands that change or make scenes import only when they work
WORK = {
    "prep": "sattools.prep.stage",
    "normalise": "sattools.radiometry.stage",
    "prior": "sattools.prior.stage",
    "fit": "sattools.fit.stage",
    "export": "sattools.export.stage",
    "align": "sattools.align.stage",
    "compare": "sattools.compare.stage",
}

__all__ = ["COMMANDS", "WORK"]
