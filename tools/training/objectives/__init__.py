"""Terms of the training loss that are off unless asked for: PM-Loss, multi-view consistency and defocus."""
