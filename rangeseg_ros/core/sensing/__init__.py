"""What is measured: cameras, range images, the sensor model, jump edges and the pixel grid."""
