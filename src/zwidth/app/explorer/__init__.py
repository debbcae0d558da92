"""Explorer (`zwidth explore`): local web page with sliders for a scene and charts of its stable walls."""
