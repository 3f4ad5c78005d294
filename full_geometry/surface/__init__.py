"""What a surface says of the medium below it: the BSDF `translucent`, textures, spectra, media that vary."""
