"""What figures compute: scenes, contenders in equal time, images and their errors."""
