/** An input that cannot be used. The message is one line: what, where, what was expected, what to do. */
export class InputError extends Error {
  /** @param {string} message */
  constructor(message) {
    super(message);
    this.name = "InputError";
  }
}
