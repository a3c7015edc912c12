"""The racer in the control plane: routes, commands, pages, and the section ``race`` of a job."""
