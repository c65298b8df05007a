"""Models of printer and camera from profiles and photographs."""
