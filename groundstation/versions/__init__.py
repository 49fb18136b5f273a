"""What is kept: model versions, a drafted vehicle, files of new effects."""
