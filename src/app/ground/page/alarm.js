// What calls an operator who looks elsewhere: a sound and a title that flashes where something is lost.
"use strict";
class Alarm {
  constructor(button) {
    this.button = button; this.state = null; this.on = true; this.audio = null; this.flashing = null;
    try { this.on = localStorage.getItem("sound") !== "off"; } catch { /* a private window keeps nothing */ }
    button.onclick = () => {
      this.on = !this.on; this.show();
      try { localStorage.setItem("sound", this.on ? "on" : "off"); } catch { /* as above */ }
      if (this.on) this.sound(880, 0);
    };
    // Browsers let nothing sound before the first click or key.
    for (const kind of ["pointerdown", "keydown"]) addEventListener(kind, () => this.open(), { once: true });
    this.show();
  }
  show() {
    this.button.classList.toggle("off", !this.on);
    this.button.setAttribute("aria-pressed", String(this.on));
  }
  open() {
    if (!this.audio && window.AudioContext) this.audio = new AudioContext();
    if (this.audio) this.audio.resume();
    return this.audio;
  }
  sound(hertz, after) {
    const audio = this.audio;
    if (!this.on || !audio || audio.state !== "running") return;
    const tone = audio.createOscillator(), volume = audio.createGain(), at = audio.currentTime + after;
    tone.frequency.value = hertz; tone.connect(volume); volume.connect(audio.destination);
    volume.gain.setValueAtTime(0.25, at); volume.gain.exponentialRampToValueAtTime(0.001, at + 0.22);
    tone.start(at); tone.stop(at + 0.25);
  }
  // Takes what is lost now, in words; null where nothing is. What was never there is not lost.
  take(lost) {
    if (lost === this.state) return;
    const before = this.state;
    this.state = lost;
    clearInterval(this.flashing);
    if (!lost) {
      document.title = "windhover";
      if (before) this.sound(880, 0);
      return;
    }
    for (const [k, hertz] of [660, 520, 660, 520].entries()) this.sound(hertz, 0.3 * k);
    let shown = true;
    document.title = `⚠ ${lost}`;
    this.flashing = setInterval(() => { shown = !shown; document.title = shown ? `⚠ ${lost}` : "windhover"; }, 700);
  }
}
