"""What figures compute: scenes, contenders in equal time, trainings, images and their errors."""
