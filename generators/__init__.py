"""Scene makers: Mitsuba worlds, camera rig, key frames and the spike simulator."""
